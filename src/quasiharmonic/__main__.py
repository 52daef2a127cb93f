"""``python -m quasiharmonic``: the command `qhm`."""

from quasiharmonic.cli import main

raise SystemExit(main())
