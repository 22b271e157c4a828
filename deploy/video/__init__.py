"""Live video for the page: H.264 over WebRTC, from a process that may block without consequence."""
