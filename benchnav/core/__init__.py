"""What every package stands on: values, random streams, the registry of parts,
settings, files and commands.
"""
