"""`python -m tandem`: the same as the installed `tandem`."""

import sys

from tandem.cli import main

sys.exit(main())
