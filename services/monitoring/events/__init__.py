"""Events of the bus: their schema, their transport over ROS 2 and Kafka, alarm rules.

Begin with `schema`; `rules` defines alarms with hysteresis, `alarm_node` evaluates them.
"""
