"""`python -m gacrl` is `gacrl`."""

import sys

from gacrl.cli import main

sys.exit(main())
