"""Contact against closed forms, rigid-body equations integrated to high order, and MuJoCo."""
