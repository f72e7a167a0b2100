"""`python -m minislam` is `minislam`."""

import sys

from minislam.cli import main

sys.exit(main())
