"""Street furniture: poles, lamps, sign panels and trunks as detections with a position, a size and a mesh.

Begin with `classify` (stems to detections); `poles` fits tubes, `lamps` and `sign_panels` their attachments.
The steps are `pipeline.steps.detect_furniture` and `pipeline.steps.furniture`.
"""
