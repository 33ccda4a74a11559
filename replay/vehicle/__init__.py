"""The vehicle file: sections, roles, validation, draft."""
