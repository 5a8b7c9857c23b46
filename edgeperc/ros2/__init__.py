"""ROS 2 without a ROS installation: messages, and a live node over Zenoh or rclpy.

`messages` turns answers into messages and CDR bytes, `graph` says what a node needs of its middleware, `zenoh_graph`
and `rclpy_graph` are the two middlewares, and `node` perceives the newest cloud of a topic.
"""
