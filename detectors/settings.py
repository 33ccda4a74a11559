"""Base of detectors' settings: typed, frozen, and without unknown keys."""

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.validation_errors import explain

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
        raise VehicleError(explain(error, None, where, kind)) from None


def identity_of(name: str, *parts: object) -> str:
    """Return a short text that changes with any of ``parts``; they must be JSON serialisable."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"
