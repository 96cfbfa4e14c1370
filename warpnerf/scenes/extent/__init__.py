"""How far a scene reaches: points, boxes, contracted space, and how fine voxels are."""
