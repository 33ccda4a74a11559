"""Options and output functions that several commands share."""
