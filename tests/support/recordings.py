"""Contents of recordings."""

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader


def cells(
    path: Path, entity: str, component: str, *, is_static: bool = False
) -> list[tuple[int, Any]]:
    """Return time and value of each row of a component, in the order of time; 0 if static."""
    found: list[tuple[int, Any]] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity and chunk.is_static == is_static:
            batch = chunk.to_record_batch()
            times = [0] * len(batch) if is_static else batch["drive"].cast("int64").to_pylist()
            for name in batch.schema.names:
                if name.endswith(component):
                    found += zip(times, batch[name].to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])
