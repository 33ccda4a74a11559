"""``crosscue truth ...``: write, import and check truth files."""
