"""python -m data_synth crowd --out data/crowd: write a synthetic sequence."""

import sys

from .cli import main

sys.exit(main())
