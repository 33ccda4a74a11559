"""Commands that inspect, convert, decode and seal logs."""
