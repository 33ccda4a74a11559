"""Networks to train and to measure, and pictures to train them on."""
