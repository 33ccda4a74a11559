"""Parameters fitted from annotated drives."""
