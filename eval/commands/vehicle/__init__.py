"""``crosscue vehicle ...``: draft and check vehicle files."""
