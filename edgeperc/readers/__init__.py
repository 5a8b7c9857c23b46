"""Read points from sensor files and captures; one module for each family of formats.

`files` recognizes a file by its content and suffix and calls the parser; `captures` reads packet captures and bags.
"""
