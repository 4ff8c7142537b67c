"""`python -m hilrunner` is `hilrunner`."""

from hilrunner.cli import main

raise SystemExit(main())
