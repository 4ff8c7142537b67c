"""`python -m hilrunner.record`: started by the runner, see launch.py."""

from hilrunner.record.process import main

raise SystemExit(main())
