"""What is trained: named models, their parameters, the voxel grid."""
