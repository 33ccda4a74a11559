"""Neural networks and the back ends that run them."""
