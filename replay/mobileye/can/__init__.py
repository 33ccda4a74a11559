"""Identify, decode and encode the frames of a Mobileye on a CAN bus."""
