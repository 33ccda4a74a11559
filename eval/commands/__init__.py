"""One file a command; ``crosscue.eval.cli.COMMANDS`` is the table that names them."""
