"""Export simulated scenes as COCO files, road masks and contact sheets."""
