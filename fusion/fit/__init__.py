"""What annotated approaches teach: how much each message says, and how soon it fades."""
