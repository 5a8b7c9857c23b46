"""``python -m edgeperc``: the ``edgeperc`` command."""

import sys

from .cli import main

sys.exit(main())
