"""Events of the bus: their schema, transport over ROS 2 and Kafka, alarm rules.

Begin with `schema`; `rules` raise alarms with hysteresis, `alarm_node` runs them.
"""
