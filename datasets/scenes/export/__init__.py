"""What simulated scenes are written as: COCO, road masks, contact sheets."""
