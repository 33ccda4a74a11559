"""``crosscue vehicle ...``."""
