"""A first vehicle file: what a log shows of the car, each choice with its reason."""
