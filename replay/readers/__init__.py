"""One file a format; ``crosscue.replay.log.FORMATS`` is the table that names them."""
