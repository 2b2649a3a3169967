"""What MuJoCo calls in a step instead of Python, in C: the search, and what it finds added to MuJoCo's own.

It does what `dano.mujoco.Bridge` does in Python for data that it knows, and calls Python for others, and
wherever there is something to be said.
"""

import enum

import warp as wp

from dano.mujoco.kernels.words import Entry, Head, REALS, SHIFT, WHOLES


def _constants(names: type[enum.IntEnum]) -> str:
    """An enumeration in C."""
    return (
        f"struct {names.__name__} {{ enum {{ {', '.join(f'{each.name} = {each}' for each in names)} }}; }};"
    )


_PROGRAM = (
    f"""
{_constants(Head)}
{_constants(Entry)}
const int n_reals = {REALS}, n_wholes = {WHOLES}, shift = {SHIFT};
"""
    + """
typedef wp::int64 word;
typedef wp::int32 whole;
typedef wp::float64 real;
typedef void (*Stage)(const void*, void*);
typedef whole (*Add)(const void*, void*, const void*);
static word* known = nullptr;
struct Callback {
    static bool is_added(const word* head, const word* entry, const char* data) {
        const whole n = *(const whole*)(data + head[Head::NCON]);
        if (n == 0) return false;
        const char* contacts = *(const char* const*)(data + head[Head::CONTACT]);
        const whole geom = *(const whole*)(contacts + (n - 1) * head[Head::STRIDE] + head[Head::GEOM]);
        const whole* geoms = (const whole*)entry[Entry::GEOMS];
        for (word k = 0; k < entry[Entry::N_GEOMS]; ++k)
            if (geoms[k] == geom) return true;
        return false;
    }
    static bool is_done(const word* head, const word* entry, const char* model, char* data) {
        if (entry[Entry::MODEL] != (word)model) return false;
        if (entry[Entry::XPOS] != *(const word*)(data + head[Head::XPOS])) return false;
        if (*(const whole*)(model + head[Head::DISABLED]) & head[Head::OFF]) return true;
        if (*(const whole*)(model + head[Head::ENABLED]) & head[Head::OVERRIDE]) return false;
        const real h = *(const real*)(model + head[Head::TIMESTEP]);
        const real* g = (const real*)(model + head[Head::GRAVITY]);
        const real fall = h * h * h * h * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]);
        if (!(fall <= *(const real*)(entry + Entry::FALL))) return false;
        if (is_added(head, entry, data)) return true;
        real* options = (real*)entry[Entry::OPTIONS];
        options[0] = h;
        options[3] = 0.0;
        ((Stage)entry[Entry::KERNEL])((const void*)entry[Entry::BOUNDS], (void*)entry[Entry::ARGUMENTS]);
        const whole found = *(const whole*)entry[Entry::FOUND];
        if (found < 0) return false;
        if (found == 0) return true;
        real* reals = (real*)entry[Entry::CONTACT];
        whole* wholes = (whole*)entry[Entry::INDEX];
        for (whole k = 0; k < found; ++k) {
            const real* row = (const real*)entry[Entry::ROWS] + k * n_reals;
            const whole* index = (const whole*)entry[Entry::WHOLES] + k * n_wholes;
            for (whole i = 0; i < n_reals; ++i) reals[i] = row[i];
            for (whole i = 0; i < n_wholes; ++i) wholes[i] = index[i];
            ((Add)head[Head::ADD])(model, data, reals);
        }
        ((Stage)head[Head::MAKE])(model, data);
        ((Stage)head[Head::ISLAND])(model, data);
        ((Stage)head[Head::PROJECT])(model, data);
        return true;
    }
    static void passive(const void* model, void* data) {
        word* head = __atomic_load_n(&known, __ATOMIC_ACQUIRE);
        __atomic_fetch_add(head + Head::INSIDE, 1, __ATOMIC_SEQ_CST);
        const word* slots = (const word*)__atomic_load_n(head + Head::SLOTS, __ATOMIC_SEQ_CST);
        const word mask = slots[0] - 1;
        word i = ((word)data >> shift) & mask;
        while (slots[1 + 2 * i] != 0 && slots[1 + 2 * i] != (word)data) i = (i + 1) & mask;
        const word* entry = slots[1 + 2 * i] == 0 ? nullptr : (const word*)slots[2 + 2 * i];
        const bool done = entry != nullptr && is_done(head, entry, (const char*)model, (char*)data);
        __atomic_fetch_sub(head + Head::INSIDE, 1, __ATOMIC_SEQ_CST);
        if (!done) ((Stage)head[Head::PYTHON])(model, data);
    }
};
__atomic_store_n(&known, (word*)head, __ATOMIC_RELEASE);
return (wp::int64)&Callback::passive;
"""
)


@wp.func_native(_PROGRAM)
def _callback(head: wp.int64) -> wp.int64: ...


@wp.kernel(enable_backward=False)
def make_callback(head: wp.int64, address: wp.array(dtype=wp.int64)):
    """Where the callback is, which reads the words about MuJoCo at `head` from now on."""
    address[0] = _callback(head)
