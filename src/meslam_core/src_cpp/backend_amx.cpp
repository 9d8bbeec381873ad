#include "backend.hpp"
namespace meslam { const Backend* amx_backend() { return nullptr; } }
