"""The Monte Carlo studies of chapter 2: settings, the work on many cores, results and pictures."""
