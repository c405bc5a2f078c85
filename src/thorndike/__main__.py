"""``python -m thorndike`` is the command line."""

import sys

from thorndike.cli.main import main

sys.exit(main())
