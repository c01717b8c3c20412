"""What runs on the device: functions in Warp's subset of Python, compiled when they are first launched.

A rover is a thread. Nothing here depends on another thread, so that a rover's numbers do not depend on its company, and
are the same on any number of threads.
"""
