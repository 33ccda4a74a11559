"""Finding and comparing the runs below a folder, and tables of decoded logs."""
