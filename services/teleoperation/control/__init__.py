"""Control of the vehicle: messages, controls, safety rules, and the driver's control lock.

Begin with `safety`: when a vehicle obeys, and when it stops.
"""
