"""What holds for all tests."""

from __future__ import annotations

import os

# No test reads or fills the user's own cache; those of the cache name a folder.
os.environ["CROSSCUE_DBC_CACHE"] = "off"
