"""From a network's raw outputs to boxes, scores, classes and masks: one file for each layout.

A new layout is one file with a subclass of ``BoxOutput`` and one row of ``table.AnyOutput``. Model
cards name it by its ``kind``; ``crosscue model init`` finds it by its ``recognise``.
"""
