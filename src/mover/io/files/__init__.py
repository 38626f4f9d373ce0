"""Checked fields, arrays, meshes, images and cameras in files of any maker."""
