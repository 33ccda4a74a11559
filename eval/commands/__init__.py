"""Commands, one module each; ``crosscue.eval.cli.COMMANDS`` lists them."""
