"""Provide self-contained example programs that users can copy.

The examples use only the public client and the public kinematics package.
"""
