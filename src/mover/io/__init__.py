"""Files of others and our own: captures, scenes, people, masks, data sets, exports.

Whatever reads a file raises `InputError` (file, field, found, expected) where the file is missing
or cannot be read, or a field is missing or wrong; docstrings name only what else is refused.
"""
