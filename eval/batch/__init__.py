"""Many drives: lists, worker processes, Ray, merging."""
