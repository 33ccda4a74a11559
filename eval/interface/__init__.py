"""What ``crosscue`` exports: a recorded drive, a run and their scores, each in a line or two.

The commands call these functions, and so do the notebooks; nothing else is promised to stay.
"""
