"""Training of networks on COCO annotations."""
