"""Settings of the monitoring commands, the same on the command line and in code.

One file for each command: `monitor`, `dashboard`, `archive`, `bus`; `limits` are thresholds that several share.
"""
