"""`python -m minislam` is `minislam`."""

import sys

from minislam.cli.main import main

sys.exit(main())
