"""Commands that find, show and export failures of runs."""
