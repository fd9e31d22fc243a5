"""Control of the vehicle: messages, controls, safety rules, the control lock of the driver.

Begin with `safety` (when a vehicle obeys and when it stops).
"""
