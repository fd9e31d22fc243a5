"""Services rolled out on edge and cloud through Open Source MANO's northbound interface (D3.2, section 2.3)."""
