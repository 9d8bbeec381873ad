"""The classics that MeSLAM is compared with, built from Open3D and GTSAM.

Every peer takes the same frames one by one, answers with the pose as it is known at that moment,
and may correct all poses at the end. Each knows what was tried to make it good: see `TRIED` in
`tsdf_slam` and `pose_graph_slam`.
"""
