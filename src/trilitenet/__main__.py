"""``python -m trilitenet``: the same as the ``trilitenet`` command."""

from __future__ import annotations

import sys

from trilitenet.apps.cli import main

if __name__ == "__main__":
    sys.exit(main())
