"""Firmware in virtual time: a clock that moves only while every firmware process sleeps, and a CAN bus that is a model."""
