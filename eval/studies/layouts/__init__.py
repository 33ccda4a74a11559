"""The study of random layouts, negatives among them: fitted on some, tested on the others."""
