"""The last step over even slabs: the pose at which drawn joints have the grey levels of the picture."""
