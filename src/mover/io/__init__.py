"""Files of others and our own: captures, scenes, people, masks, data sets, exports."""
