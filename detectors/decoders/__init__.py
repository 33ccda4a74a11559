"""Decode a network's raw outputs to boxes, scores, classes and masks; one module per layout.

A new layout is a module with a subclass of ``BoxOutput`` and an entry of ``table.AnyOutput``. Model
cards name it by its ``kind``; ``crosscue model init`` recognises it by its ``recognise``.
"""
