"""What a log shows of the car that made it: camera mounting, signals that agree."""
