"""Base class of the records of a run."""

from typing import Any

from pydantic import BaseModel, ConfigDict


class Record(BaseModel):
    """A record that is validated when it is created and read; unknown keys are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, populate_by_name=True, defer_build=True
    )

    def as_json(self) -> dict[str, Any]:
        """Return the record as plain JSON values, with the JSON names of its fields."""
        return self.model_dump(mode="json", by_alias=True)
