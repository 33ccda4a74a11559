"""Public data sets and folders of labelled images, one adapter each."""
