"""The actions of servers as tools: their list, calls, goals, and the consent of a user."""
