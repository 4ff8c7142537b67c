"""The article's figures and tables beside ours: every row is measured in the run that prints it."""
