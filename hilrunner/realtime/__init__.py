"""All that runs inside a period, in the order data passes: decode, command, faults, cycle, encode; ring, histogram; clock, socketcan; loop."""
