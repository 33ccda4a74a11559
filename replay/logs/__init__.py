"""Open logs of any format, select parts of them, and summarise them."""
