"""The runs below a folder as tables, and SQL over them."""
