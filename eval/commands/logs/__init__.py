"""A log: what it holds, converted, decoded, sealed."""
