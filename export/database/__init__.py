"""The top-view database: built scene by scene, resumed, spread over processes; its roads drawn by hand."""
