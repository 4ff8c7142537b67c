"""The recorder: its own process, sideways from the loop; ring in, MCAP and cross-check out."""
