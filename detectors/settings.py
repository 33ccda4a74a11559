"""Base of detectors' settings: typed, frozen, and without unknown keys."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscue.replay.errors import VehicleError

Proportion = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Settings(BaseModel):
    """Base class of every detector's settings."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


S = TypeVar("S", bound=Settings)


def settings_of(kind: type[S], given: Mapping[str, Any], where: str) -> S:
    """Validate settings and fill in defaults.

    Args:
        kind: Type of the settings.
        given: Settings as in the vehicle file.
        where: Name of the place in error messages.

    Raises:
        VehicleError: A name is unknown or a value is invalid.
    """
    try:
        return kind.model_validate(dict(given))
    except ValidationError as error:
        raise VehicleError(_explained(error, kind, where)) from None


def _explained(error: ValidationError, kind: type[BaseModel], where: str) -> str:
    first, *others = error.errors(include_url=False)
    name = ".".join(str(part) for part in first["loc"])
    more = f" (and {len(others)} more)" if others else ""
    if first["type"] == "extra_forbidden":
        close = difflib.get_close_matches(name, kind.model_fields, n=1)
        hint = (
            f"did you mean {close[0]}?" if close else f"there are: {', '.join(kind.model_fields)}"
        )
        return f"{where}: {name}: no such setting; {hint}{more}"
    if first["type"] == "missing":
        return f"{where}: {name}: missing; add it{more}"
    return (
        f"{where}: {name}: {first['msg'].lower()}, got {first['input']!r}; correct the value{more}"
    )


def identity_of(name: str, *parts: object) -> str:
    """Return a short text that changes with any of ``parts``; they must be JSON serialisable."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"
