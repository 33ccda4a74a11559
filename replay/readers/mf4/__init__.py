"""Reader of ASAM MDF 4 logs."""
