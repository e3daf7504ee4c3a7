"""Runs the suite: `python -m tests`, which `scripts/test` calls. Arguments go to pytest.

Python up to 3.11.8 fails with a SystemError when garbage is collected while pytest parses a module. So nothing is collected until
the tests are (`conftest.py` ends that).
"""

from __future__ import annotations

import gc
import sys

import pytest

gc.disable()
sys.exit(pytest.main(sys.argv[1:]))
