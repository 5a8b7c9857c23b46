"""The top-view database of KITTI scenes, and the hand-drawn roads in it."""
