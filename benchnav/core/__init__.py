"""Foundation of all packages: values, random streams, parts, files and commands."""
