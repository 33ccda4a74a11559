"""Batches of many drives: drive lists, worker processes, Ray and merging of runs."""
