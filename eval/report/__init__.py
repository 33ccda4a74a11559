"""Reports of scores as HTML pages, figures, text, JUnit XML and MLflow runs."""
