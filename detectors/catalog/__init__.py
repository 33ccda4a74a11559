"""Model cards, which describe a network's input and the meaning of its output."""
