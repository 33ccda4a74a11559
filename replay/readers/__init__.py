"""One file a format; ``crosscue.replay.formats.FORMATS`` is the table that names them."""
