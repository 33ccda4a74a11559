"""The public interface of ``crosscue``: logs, runs, scores, fits, training and studies.

The commands and the notebooks call these functions. Everything else is private and may change.
"""
