"""The stages that process one drive: detect and estimate."""
