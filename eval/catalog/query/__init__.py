"""SQL queries over the runs below a folder."""
