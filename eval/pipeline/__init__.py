"""The stages of one drive: detect, estimate, and the tables between them."""
