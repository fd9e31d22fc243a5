"""Street furniture: poles, lamps, sign panels and trunks as instances with a position, a size and a mesh.

Begin with `classify` (candidates to instances); `poles` fits tubes, `lamps` and `sign_panels` what they carry.
The steps are `pipeline.steps.finds` and `pipeline.steps.furniture`.
"""
