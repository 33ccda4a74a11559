"""A Mobileye on a CAN bus: its frames told apart, decoded and encoded."""
