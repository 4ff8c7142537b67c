"""One file a command: `add_arguments(parser)` and `main(args) -> exit code`; imports of heavy rooms happen inside `main`."""
