"""After the run: read the log, report latency, replay, compare with the DAE, judge."""
