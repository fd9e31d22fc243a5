"""Settings of the monitoring commands, the same on the command line and in code.

One file for each command: `monitor`, `dashboard`, `archive`, `bus`, `osm`; `limits` are thresholds that several share,
`scaling` are the settings of the autoscaling policy.
"""
