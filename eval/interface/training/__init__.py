"""Networks trained, and the pictures they are trained on."""
