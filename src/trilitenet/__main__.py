"""The ``trilitenet`` command, also as ``python -m trilitenet``."""

from __future__ import annotations

import sys

__all__ = ["main"]


def main() -> int:
    """Run the command line of the process; Ctrl-C while its modules are imported is told as later."""
    try:
        from trilitenet.apps.cli import main as run
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted\n")
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
