"""The vehicle file: its sections, roles of topics, validation and drafting."""
