"""Levels of events in /log, as rcl_interfaces/msg/Log numbers them."""

LOG_LEVEL_INFO = 20
LOG_LEVEL_WARNING = 30
LOG_LEVEL_ERROR = 40
