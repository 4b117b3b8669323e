"""`python -m gacrl` is `gacrl`."""

import sys

from gacrl.cli.main import main

sys.exit(main())
