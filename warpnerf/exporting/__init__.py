"""Trained fields as files for other programs: meshes, points, splats, volumes, pages, cameras."""
