"""`python -m deal_hw` is the same as the `deal-hw` command."""

from __future__ import annotations

import sys

from deal_hw.cli.start import main

if __name__ == "__main__":
    sys.exit(main())
