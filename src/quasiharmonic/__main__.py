"""``python -m quasiharmonic``: the command `qhm`."""

from .cli import main

raise SystemExit(main())
