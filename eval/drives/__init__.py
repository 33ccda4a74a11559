"""From the logs of drives to run folders: replay, detect, estimate."""
