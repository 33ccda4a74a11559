"""Reports: HTML pages, figures, JUnit."""
