"""What people look at: tables, figures and playback."""
