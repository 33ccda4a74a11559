"""A drive: opened for reading, summarised, converted, sealed."""
