"""Requirements as data: formulas of signal temporal logic over the signals of a run, judged with a margin in the signal's own unit."""
